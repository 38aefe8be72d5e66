"""The global context: what a preprocessing pass learns of a scene, for every sampler to use."""
