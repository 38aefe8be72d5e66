"""HTTP: routes, errors, events. Never imports Mitsuba."""
