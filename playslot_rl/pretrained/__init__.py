"""Small world models that ship with the package, with how they were made."""
