"""The manual: the page of all commands, and completion of words in the shell. Both read the parsers."""
