"""python -m mocapfix"""

from mocapfix.cli import main

if __name__ == "__main__":
    main()
