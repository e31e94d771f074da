"""disco_twin/camera"""
