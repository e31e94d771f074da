"""disco_twin/light"""
