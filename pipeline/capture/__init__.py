"""pipeline/capture"""
