"""Bridges to other people's frameworks, one module each, to be imported only where that framework is installed."""
