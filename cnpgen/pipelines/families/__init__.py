"""Families of scenes: furniture and objects at random, with starts and goals of a robot."""
