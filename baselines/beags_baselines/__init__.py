"""Methods of other papers that cut objects out of a scene, as refiners of beags (README.md)."""
