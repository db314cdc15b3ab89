"""``veilface demo``: the real service, with synthetic people."""
