"""The simulated DISCO rig: objects, light, cameras, ground truth, reports and the command line."""
