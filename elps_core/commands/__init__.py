"""Commands that need no server. Mitsuba is loaded when one runs, not before."""
