"""What a piece of seafloor is made of, and the sites that have names."""

from __future__ import annotations

from dataclasses import dataclass, replace

from data_synth import types as t


@dataclass(frozen=True)
class Site:
    """What a piece of seafloor is made of. Lengths in metres, densities per square metre.

    `relief` to `grit` shape the rock, `sand` is the share of the ground under sand, `rubble`,
    `turf` and `coralline` its cover (0..1); then follow what stands on it. The defaults give the
    roughness spectrum and slopes of a real reef flat (`docs/seafloor_vs_reef.png`).
    """

    relief: float = 0.14
    relief_wavelength: float = 8.0
    hurst: float = 0.75
    step: float = 0.32
    step_wavelength: float = 4.0
    step_level: float = 0.5
    lump: float = 0.32
    lump_cell: float = 1.5
    lump_gain: float = 0.46
    broken_least: float = 0.15
    grit: float = 0.0035
    sand: float = 0.0
    sand_relief: float = 0.02
    ripple: float = 0.012
    ripple_wavelength: float = 0.14
    ripple_wander: float = 0.5
    rubble: float = 0.3
    turf: float = 0.8
    coralline: float = 0.5
    patch: float = 3.0
    fine: float = 1.0
    tone: tuple[float, float, float] = (1.0, 0.88, 0.68)
    sand_tone: tuple[float, float, float] = (0.46, 0.41, 0.31)
    boulder: float = 0.0
    boulder_size: float = 1.0
    massive: float = 1.2
    branching: float = 0.8
    plate: float = 0.25
    encrusting: float = 1.5
    soft: float = 0.4
    sponge: float = 0.1
    urchin: float = 0.1
    kelp: float = 0.0
    coral_size: float = 1.0
    cluster: float = 0.7  # 0 evenly strewn .. 1 in stands with bare ground between

    def densities(self) -> dict[int, float]:
        """Return things per square metre by kind."""
        return {
            t.BOULDER: self.boulder,
            t.MASSIVE: self.massive,
            t.BRANCHING: self.branching,
            t.PLATE: self.plate,
            t.ENCRUSTING: self.encrusting,
            t.SOFT: self.soft,
            t.SPONGE: self.sponge,
            t.URCHIN: self.urchin,
            t.KELP: self.kelp,
        }


SITES: dict[str, Site] = {
    "reef": Site(),
    "low_reef": replace(
        Site(),
        relief=0.07,
        step=0.0,
        lump=0.13,
        boulder=0.0,
        massive=1.6,
        branching=1.4,
        plate=0.4,
        coral_size=0.7,
        sand=0.18,
    ),
    "boulders": replace(
        Site(),
        relief=0.12,
        step=0.0,
        lump=0.05,
        lump_gain=0.5,
        boulder=1.1,
        massive=0.0,
        branching=0.0,
        plate=0.0,
        encrusting=1.2,
        soft=0.3,
        sponge=0.8,
        urchin=0.8,
        kelp=0.15,
        sand=0.25,
        tone=(0.78, 0.72, 0.62),
        sand_tone=(0.36, 0.33, 0.27),
        coralline=0.45,
        rubble=0.35,
        fine=0.5,
    ),
    "reef_and_sand": replace(Site(), sand=0.45, step=0.35, step_level=0.3, massive=0.9, fine=2.0),
    "sand": replace(
        Site(),
        relief=0.02,
        step=0.0,
        lump=0.02,
        sand=1.0,
        massive=0.0,
        branching=0.0,
        plate=0.0,
        encrusting=0.0,
        soft=0.0,
        sponge=0.0,
        urchin=0.02,
        rubble=0.0,
    ),
}
