"""Identification of a plant under control: subspace methods, prediction error, regions."""
