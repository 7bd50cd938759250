"""The stages, one file each: they draw, solve or reject whole rounds of draws."""
