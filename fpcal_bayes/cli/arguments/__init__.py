"""Options of all commands; nothing here is slow to import."""
