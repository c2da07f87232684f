"""The kinds of figures that SIERRA ships: what each needs and which keys it has. Their modules import no plotting library."""
