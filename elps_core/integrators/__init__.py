"""Integrators, and their registration with Mitsuba."""
