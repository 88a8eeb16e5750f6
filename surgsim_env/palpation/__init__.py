"""The main job: press an organ site by site, map its stiffness, say where a lesion was felt and how far from the truth."""
