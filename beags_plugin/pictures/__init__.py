"""Pictures for users: contact sheets, objects alone, films, masks."""
