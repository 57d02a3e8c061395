"""The first examples: small models with exact answers."""
