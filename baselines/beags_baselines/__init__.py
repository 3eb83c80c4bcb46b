"""Methods of other papers that take objects out of a scene, as refiners of beags (README.md)."""
