"""Which plant a simulated rig or a twin is made of."""

from __future__ import annotations

from autotune.config.twin import PlantSettings
from sim.plant import Plant, make_plant


def plant_of(settings: PlantSettings, *, u_safe: float, converters: bool = True) -> Plant:
    """Return the plant that the settings name: one of the four, or that of a model file.

    Parameters
    ----------
    settings : PlantSettings
        Which plant.
    u_safe : float
        Command at which a plant of a model is at rest at the start, where it has such a rest [u unit].
    converters : bool
        Whether one of the four brings its own converters.

    Raises
    ------
    InputError
        The model file cannot be read, or has what a twin does not take along.
    """
    if settings.model is not None:
        from drivers.model_plant import model_plant  # a run on one of the four does not pay for equations

        return model_plant(settings, settings.model, u_start=u_safe)
    assert settings.plant is not None  # the settings hold one of the two
    return make_plant(
        settings.plant, seed=settings.seed, noise=settings.noise, start=settings.start, converters=converters
    )
