"""A local page: the causal graph, interventions and the moving world side by side.

``scm-world studio pushing`` starts it; see ``docs/studio.md``. It needs the extra ``studio``.
"""
