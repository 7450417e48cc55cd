"""perchctl: hang a Crazyflie onto a ceiling by the sight of a printed target."""

__version__ = "0.1.0"
