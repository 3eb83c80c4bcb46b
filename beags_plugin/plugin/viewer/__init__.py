"""The viewer: pictures of a scene, its panel and its files."""
