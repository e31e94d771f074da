"""pipeline/reconstruct"""
