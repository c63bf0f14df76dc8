"""No test is judged by how long it takes: the first example of a process may load scipy on a busy machine."""

from hypothesis import settings

settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
