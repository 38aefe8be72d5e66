"""Images as files: EXR for data, PNG for eyes."""
