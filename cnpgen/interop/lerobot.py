"""The bridge to LeRobot (the add-on ``cnpgen.addons.frameworks``)."""

from cnpgen.schema.public_names import lazy_exports

__getattr__, __dir__ = lazy_exports(__name__, __file__)
