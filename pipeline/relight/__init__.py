"""pipeline/relight"""
