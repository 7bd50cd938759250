"""x."""
from cnpgen.cli.parser import *
def add(commands): pass
