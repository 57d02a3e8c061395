"""What the world is like: generative programs and their mathematics."""
