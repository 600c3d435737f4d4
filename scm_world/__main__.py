"""``python -m scm_world`` is ``scm-world``."""

from scm_world.cli import main

if __name__ == "__main__":
    main()
