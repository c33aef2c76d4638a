"""The story: the only file that knows every stage and the configuration; each command is one function here."""
