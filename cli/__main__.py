"""python -m rangecheck_cli"""

from .main import main

main()
