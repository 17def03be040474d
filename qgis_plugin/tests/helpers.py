"""What the tests say to QGIS."""

import sqlite3
from contextlib import closing

from processing.gui.Postprocessing import handleAlgorithmResults
from qgis.core import (
    QgsApplication,
    QgsProcessingContext,
    QgsProcessingFeedback,
    QgsProcessingOutputLayerDefinition,
    QgsProject,
)


class Feedback(QgsProcessingFeedback):
    """Keeps what it hears; cancels itself after so many reports of progress."""

    def __init__(self, cancel_after=None):
        super().__init__(False)
        self.percents, self.stages, self.errors, self.infos = [], [], [], []
        self.cancel_after = cancel_after
        self.progressChanged.connect(self.progressed)

    def progressed(self, percent):
        self.percents.append(percent)
        if self.cancel_after is not None and len(self.percents) >= self.cancel_after:
            self.cancel()

    def setProgressText(self, text):
        self.stages.append(text)

    def pushInfo(self, text):
        self.infos.append(text)

    def pushWarning(self, text):
        self.infos.append(text)

    def pushConsoleInfo(self, text):
        self.infos.append(text)

    def reportError(self, text, *_):
        self.errors.append(text)


def algorithm(name):
    found = QgsApplication.processingRegistry().createAlgorithmById(f"gisradar:{name}")
    assert found is not None, name
    return found


def context_of(project):
    context = QgsProcessingContext()
    context.setProject(project)
    return context


def run_algorithm(name, parameters, *, feedback=None, load=False):
    """Return the results and what was heard; results are None where the run failed."""
    feedback = feedback or Feedback()
    one, context = algorithm(name), context_of(QgsProject.instance())
    if load:
        for definition in one.parameterDefinitions():
            key = definition.name()
            if definition.type() == "vectorDestination" and key in parameters:
                target = QgsProcessingOutputLayerDefinition(parameters[key], QgsProject.instance())
                parameters[key] = target
    fine, reason = one.checkParameterValues(parameters, context)
    if not fine:
        feedback.errors.append(reason)
        return None, feedback
    results, done = one.run(parameters, context, feedback)
    if done and load:
        assert handleAlgorithmResults(one, context, feedback, parameters)
    return (results if done else None), feedback


def one_sentence(feedback):
    """Return the only error: one line, no traceback."""
    errors = [text for text in feedback.errors if text]
    assert len(set(errors)) == 1, errors
    assert "\n" not in errors[0].strip()
    assert "Traceback" not in errors[0]
    return errors[0]


def is_whole(package):
    """Tell whether a GeoPackage is sound."""
    with closing(sqlite3.connect(package)) as database:
        return database.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def layer_called(name):
    (layer,) = QgsProject.instance().mapLayersByName(name)
    return layer


def leftovers(folder):
    return sorted(path.name for path in folder.glob(".*.part"))
