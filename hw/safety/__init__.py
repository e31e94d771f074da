"""Lasers go off when their program ends: ending signals, and guard processes that own the lasers' ports."""
