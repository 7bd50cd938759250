"""Constraints: one file per kind, each in a symbolic and a measured form."""
