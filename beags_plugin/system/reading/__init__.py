"""Reading files of strangers: nothing in them runs, and their promises are checked before they are believed."""
