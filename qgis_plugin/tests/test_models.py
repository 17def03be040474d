"""Algorithms chained in a model, as the modeller of QGIS does it."""

from conftest import SAMPLE
from helpers import Feedback, context_of, is_whole
from qgis.core import (
    QgsProcessingModelAlgorithm,
    QgsProcessingModelChildAlgorithm,
    QgsProcessingModelChildParameterSource,
    QgsProcessingModelOutput,
    QgsProcessingModelParameter,
    QgsProcessingParameterFile,
    QgsProject,
)

VALUE = QgsProcessingModelChildParameterSource.fromStaticValue
FROM = QgsProcessingModelChildParameterSource.fromChildOutput


def child(model, name, **sources):
    """Add a step to a model."""
    step = QgsProcessingModelChildAlgorithm(f"gisradar:{name}")
    step.setChildId(name)
    for key, source in sources.items():
        step.addParameterSources(key, [source])
    assert step.reattach()
    return step


def test_a_model_from_map_to_heat_map(provider, qgis_new_project, brief, tmp_path):
    """The tiles of one step go into the next two; nothing is loaded by the way."""
    model = QgsProcessingModelAlgorithm("chain", "test")
    model.addModelParameter(
        QgsProcessingParameterFile("lanelets", "Map"), QgsProcessingModelParameter("lanelets")
    )
    model.addChildAlgorithm(
        child(
            model, "splitlanelets",
            MAP=QgsProcessingModelChildParameterSource.fromModelParameter("lanelets"),
        )
    )  # fmt: skip
    measure = child(
        model, "measure",
        RECORDINGS=VALUE(str(brief / "R1.parquet")), POSES=VALUE(str(SAMPLE / "R1.json")),
        TILES=FROM("splitlanelets", "OUTPUT"), MAP=VALUE(str(SAMPLE / "junction.osm")),
    )  # fmt: skip
    model.addChildAlgorithm(measure)
    heatmap = child(
        model, "heatmap",
        DATASET=FROM("measure", "OUTPUT"), INTERVAL=VALUE("50s"), LOAD=VALUE(False),
    )  # fmt: skip
    result = QgsProcessingModelOutput("map", "map")
    result.setChildId("heatmap")
    result.setChildOutputName("OUTPUT")
    heatmap.setModelOutputs({"map": result})
    model.addChildAlgorithm(heatmap)
    model.updateDestinationParameters()
    out, context, heard = tmp_path / "map", context_of(QgsProject.instance()), Feedback()
    given = {"lanelets": str(SAMPLE / "junction.osm"), "heatmap:map": str(out)}
    assert model.canExecute()[0]
    _, done = model.run(given, context, heard)
    assert done, heard.errors
    assert is_whole(out / "heatmap.gpkg")
    assert context.layersToLoadOnCompletion() == {}
