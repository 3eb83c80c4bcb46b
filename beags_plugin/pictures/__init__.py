"""Pictures for people: contact sheets, objects alone, films, masks."""
