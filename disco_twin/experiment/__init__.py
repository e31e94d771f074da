"""A scene with all that is built from it, its run folder, and the pipeline as a process of its own."""

from disco_twin.experiment.experiment import Experiment

__all__ = ["Experiment"]
