"""The course of a road from what stands beside it and drives on it, Trusheim, Condurache and Mertins [T17]."""
