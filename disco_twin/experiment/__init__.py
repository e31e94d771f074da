"""A scene with all that is built from it, its run folder, and the pipeline as a process of its own."""
