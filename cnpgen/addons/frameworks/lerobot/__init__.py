"""The bridge to LeRobot: a processor step that makes every action chunk of a policy a valid motion."""

from cnpgen.addons.frameworks.lerobot.chunk_step import ChunkStep

__all__ = ["ChunkStep"]
