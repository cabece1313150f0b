"""Questions about a scene: what people and programs are asked, and the answers where somebody knows them."""
