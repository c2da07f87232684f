"""The origin of a result: the code (`source`), the programs around it (`programs`), and the machine (`environment`)."""
