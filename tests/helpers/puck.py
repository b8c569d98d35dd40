"""Scene of a puck, as the file that commands are run on."""

SCENE = """
[world]
time_step = 0.1
substeps = 4

[[body]]
name = "puck"
shape = { kind = "circle", radius = 0.1 }
known = { r = 0.5, mu_c = 0.3 }
"""
