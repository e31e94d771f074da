"""pipeline/calibrate"""
