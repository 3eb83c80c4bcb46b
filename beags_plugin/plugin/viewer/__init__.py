"""The viewer: what it shows of a scene, its panel and its files."""
