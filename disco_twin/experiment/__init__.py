"""A scene with all that is built from it, the keys of it, its run folder, and the pipeline as a process of its own."""
