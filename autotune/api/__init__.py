"""The public face: what ``import autotune as at`` offers, one file per part of the way of the data.

Every function here coerces what a person has (paths, DataFrames, arrays, python-control systems) and hands it to the
room that does the work; the rooms stay as they are, and can be imported by themselves.
"""
