"""An ASF/AMC pair in CMU's layout with a few bones of every kind, for tests of readers and writers."""

ASF = """\
# as CMU's, of some bones
:version 1.10
:name VICON
:units
  mass 1.0
  length 0.45
  angle deg
:documentation
   length and axis are words here too
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 1 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name lhipjoint
     direction 0.6 -0.8 0
     length 2.5
     axis 0 0 0 XYZ
  end
  begin
     id 2
     name lfemur
     direction 0.6 -0.8 0
     length 8
     axis 0 0 20  XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
     id 3
     name lfoot
     direction 0 0 1
     length 8
     axis 10 20 30 XYZ
    dof ry rx
  end
  begin
     id 4
     name head
     direction 0 1 0
     length 16
     axis 90 0 0 ZXY
    dof tx rz l
  end
:hierarchy
  begin
    root lhipjoint head
    lhipjoint lfemur
    lfemur lfoot
  end
"""
FRAMES = """\
7
root 1 2 3 10 20 30
lfemur 15 -5 25
head 0.5 40 2
lfoot 7 8
8
root 1.5 2.5 3.5 11 21 31
lfoot 7.5 8.5
lfemur 16 -6 26
head 0.25 41.25 3
"""
AMC = f"#!OML:ASF 09.ASF\n:FULLY-SPECIFIED\n:DEGREES\n{FRAMES}"
