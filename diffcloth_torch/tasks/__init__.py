"""Tasks: a scene, its control and its objective; one file per task."""
