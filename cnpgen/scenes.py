"""Planning problems in scenes: files of other software, families, observations, plans ('cnpgen docs scene-files')."""

from cnpgen.schema.public_names import lazy_exports

__getattr__, __dir__ = lazy_exports(__name__, __file__)
