"""The page in the browser: scene, charts, panels, controls."""
