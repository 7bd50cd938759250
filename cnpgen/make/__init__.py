"""Generation of datasets: recipes, specifications, shards, certified plans and fresh boundary problems."""
