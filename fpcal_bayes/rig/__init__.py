"""The live cell: a ticket driven on the controllers, read by the interferometer, handed over as a session."""
