"""An example outside the tree: is the kerb lowered, and where?"""
