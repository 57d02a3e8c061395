"""Lane-level intersections (Meyer, Walter, Lauer 2020)."""
