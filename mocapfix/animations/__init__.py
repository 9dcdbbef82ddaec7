"""Animations: BVH and AMC input, cleaned in joint rotations and in the root's position, without markers.

- `clean`: the stages in order, and the animation as they leave it
- `detect`: its faults; offsets, those that are constant over some frames (pops and flips)
- `repair`: their repair, by the one of several `repair_methods` that has the smallest errors elsewhere in the take,
  and which repairs are applied
- `lock_feet`: feet that are held where they stand (`--feet lock`)
"""
