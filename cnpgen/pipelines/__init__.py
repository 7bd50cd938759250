"""Pipelines: ordered stages that draw boundary problems and reject the impossible ones, one file per stage."""
