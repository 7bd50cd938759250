"""Constraints: one file per kind or family of kinds, each kind in a symbolic and a measured form."""
