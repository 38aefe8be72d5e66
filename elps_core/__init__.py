"""The renderer: scenes, paths, global context, integrators, estimates.

Knows no HTTP, no Redis and no Celery. Importing the package costs nothing: Mitsuba is loaded by
:func:`elps_core.device.use`.
"""
