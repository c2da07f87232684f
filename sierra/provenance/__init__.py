"""What a result came from: the code (`source`), the programs around it (`programs`), the machine (`environment`)."""
