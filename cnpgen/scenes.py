"""Planning problems in scenes: files of other software, families, observations, plans ('cnpgen docs scene-files')."""

from cnpgen import _lazy_exports

__all__, __getattr__, __dir__ = _lazy_exports(__name__, __file__)
