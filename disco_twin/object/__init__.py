"""disco_twin/object"""
