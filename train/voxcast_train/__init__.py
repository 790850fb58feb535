"""Training of networks that voxcast runs. See README.md beside this package."""
