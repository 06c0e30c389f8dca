"""Bodies of material points or finite elements: their state, seeding, and distribution over ranks."""
