"""How to learn about the world: engines, none of which knows a concrete model."""
