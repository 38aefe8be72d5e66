"""Scenes: unpacking and checking uploads, instantiating them safely, and their digests."""
