"""Mending, before anything is filled: samples are put under the labels they belong to, and moved markers told apart.

Labels first, for what bears a wrong one looks like every other fault; then moved markers; what is to be replaced and what is
missing is left to the fill. Samples change places and nothing else.
"""

from mocapfix.mend.fragments import JOINED, fragments
from mocapfix.mend.labels import labels, relabelled
from mocapfix.mend.moved import Parts, parted
from mocapfix.mend.refused import put_back

__all__ = ["JOINED", "Parts", "fragments", "labels", "parted", "put_back", "relabelled"]
