"""Contacts of the body with the floor: their detection, feet that are held, and the events of gait.

- `body_contacts`: the stage: find the contacts of the solved body and hold its feet
- `contacts`: contacts as later stages, reports and files use them
- `find_contacts`: contacts from the positions of the joints
- `plate_contacts`: contacts with force plates, which replace these
- `gait_events`: foot strikes and foot offs
- `foot_displacements`: where a foot shall be while it stands
"""
