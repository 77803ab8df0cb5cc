"""Suite files small enough for tests."""

CELL = """\
  - task: spring.yaml
    data: log.npz
    method: least-squares
    budget: 400
    set: {windows: 4}
"""
"""A calibration of some hundredths of a second."""
