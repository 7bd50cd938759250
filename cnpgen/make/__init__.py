"""Datasets made: their recipe, the blueprint, shards, certified plans, problems to solve."""
