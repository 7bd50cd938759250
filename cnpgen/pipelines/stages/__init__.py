"""Stages, one file each: they sample, solve or reject whole batches of candidates."""
