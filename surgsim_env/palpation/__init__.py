"""The main job: press an organ site by site, map its stiffness, and say where a lesion was felt."""
