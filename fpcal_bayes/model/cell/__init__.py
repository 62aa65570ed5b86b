"""What a cell is: one module for each kind of table of its TOML file."""
