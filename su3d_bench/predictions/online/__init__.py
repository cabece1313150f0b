"""Maps of systems that build them while they walk, each with its own points: OVO, RayFronts, ESAM, OnlineAnySeg."""
