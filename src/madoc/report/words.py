"""Numbers and names as a reader wants them."""

import math

_FIELD_WORDS = {
    "body_mass": "mass",
    "body_mass_and_inertia": "mass, inertia",
    "body_length": "length",
    "dof_damping": "damping",
    "dof_armature": "armature",
    "dof_frictionloss": "dry friction",
    "jnt_stiffness": "stiffness",
    "geom_friction": "friction",
    "actuator_gain": "gain",
    "action_delay": "delay",
    "signal_bias": "bias",
}
"""What a parameter's field is called beside its element."""

_METRIC_WORDS = {
    "accuracy_sa": "from (s, a)",
    "accuracy_sas": "from (s, a, s′)",
    "discriminator_loss_sa": "from (s, a)",
    "discriminator_loss_sas": "from (s, a, s′)",
}


def parameter_title(name: str) -> str:
    """`dof_damping.foot_joint` as `foot_joint damping`."""
    field, _, element = name.partition(".")
    word = _FIELD_WORDS.get(field, field.replace("_", " "))
    return f"{element} {word}" if element else word


def metric_title(name: str) -> str:
    """A metric's name in words."""
    return _METRIC_WORDS.get(name, name.replace("_", " "))


def number(value: float | None, digits: int = 4) -> str:
    """So many significant digits, a real minus, powers of ten only for the very large and small."""
    if value is None or not math.isfinite(value):
        return "–"
    size = abs(value)
    if size and (size < 1e-4 or size >= 1e7):
        mantissa, _, exponent = f"{value:.{max(digits - 2, 0)}e}".partition("e")
        return f"{mantissa}·10{_superscript(int(exponent))}".replace("-", "−")
    if size >= 10 ** (digits - 1):
        return f"{value:,.0f}".replace(",", " ").replace("-", "−")
    text = f"{value:.{digits}g}"
    return text.replace("-", "−")


def count(value: float) -> str:
    """A whole number, thousands apart."""
    return f"{value:,.0f}".replace(",", " ")


def short_count(value: float) -> str:
    """`60k`, `1.5M`: for the ticks of an axis."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}".replace("-", "−")
    return f"{value:g}".replace("-", "−")


def duration(seconds: float) -> str:
    """`0.8 s`, `42 s`, `3 min 5 s`, `2 h 10 min`."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def _superscript(value: int) -> str:
    return str(value).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
