"""The models of a process: several by name, one of them the default, exchanged while requests go on."""
