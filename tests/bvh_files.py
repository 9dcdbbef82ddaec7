"""A BVH of a small figure with joints of every kind, for tests of readers, repairs and writers."""

HIERARCHY = """\
HIERARCHY
ROOT Hips
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Left Knee
  {
    OFFSET 0 -60 0
    CHANNELS 1 Xrotation
    JOINT Ns:Foot
    {
      OFFSET 0 -50 5
      CHANNELS 3 Yrotation Zrotation Xrotation
      End Site
      {
        OFFSET 0 0 20
      }
      End Site
      {
        OFFSET 5 0 18
      }
    }
  }
  JOINT Chest
  {
    OFFSET 0 60 0
    CHANNELS 6 Xposition Yposition Zposition Xrotation Yrotation Zrotation
    End Site
    {
      OFFSET 0 5 0
    }
    JOINT Head
    {
      OFFSET 0 40 0
      CHANNELS 0
      End Site
      {
        OFFSET 0 20 0
      }
    }
  }
}
"""
ROWS = (
    "10.5000 90.0000 -3.2500 10.0000 20.0000 30.0000 15.0000 1.0000 2.0000 3.0000 0.0000 60.0000 0.0000 5.0000 6.0000 7.0000",
    "10.6000 90.1000 -3.1500 11.0000 21.0000 31.0000 16.0000 1.1000 2.1000 3.1000 0.0000 60.5000 0.0000 5.1000 6.1000 7.1000",
    "10.7000 90.2000 -3.0500 12.0000 22.0000 32.0000 17.0000 1.2000 2.2000 3.2000 0.0000 61.0000 0.0000 5.2000 6.2000 7.2000",
)
TEXT = HIERARCHY + "MOTION\nFrames: 3\nFrame Time: .0083333\n" + "\n".join(ROWS) + "\n"
