"""Tasks: a scene, what moves in it, and what is to be achieved; one file per task."""
