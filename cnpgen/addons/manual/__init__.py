"""The manual: descriptions of recipes, kinds and keys, pages from the code, and completion of words in the shell."""
