"""Reading files of any origin: nothing in them runs, and the sizes that they state are checked first."""
