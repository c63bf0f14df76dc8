"""No test is judged by how long it takes: the first example of a process may load scipy on a busy machine."""

from sealfit.threads import one_thread

one_thread()

from hypothesis import settings  # noqa: E402

settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
