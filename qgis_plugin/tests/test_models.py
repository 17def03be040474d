"""Algorithms chained in a model and repeated in a batch, as the modeller of QGIS does it."""

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


def test_a_model_from_map_to_heat_map(provider, qgis_new_project, site, tmp_path):
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
        RECORDINGS=VALUE(str(SAMPLE / "R1.parquet")), POSES=VALUE(str(SAMPLE / "R1.json")),
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


def test_a_batch(run, tmp_path):
    """The same algorithm again and again with other values."""
    counts = []
    for number, length in enumerate((0.5, 1.0)):
        parameters = {
            "MAP": str(SAMPLE / "junction.osm"), "LENGTH": length,
            "OUTPUT": str(tmp_path / f"{number}.gpkg"),
        }  # fmt: skip
        results, heard = run("splitlanelets", parameters)
        assert heard.errors == []
        counts.append(results["TILES"])
    assert counts[0] > 1.8 * counts[1]
