"""Bridges to other people's frameworks, each imported only where that framework is; what they share needs none."""
