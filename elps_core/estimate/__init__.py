"""Images from chunks: accumulation, errors, and when to stop. Needs no Mitsuba."""
