"""What a material does with light, as a table of energy and as the polar plot of the report's figure 3.

Angles in degrees here, because people read them; everything else as in the rest of the room.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from rangecheck.arrays import FloatArray
from rangecheck.errors import ArrayError
from rangecheck.reflectance.brdf import lobe_brdf
from rangecheck.reflectance.energy import lobe_albedo
from rangecheck.reflectance.fresnel import conductor_fresnel, fresnel_table
from rangecheck.reflectance.lobe import MASKINGS, UNMASKED, two_numbers
from rangecheck.reflectance.material import Material

TABLE_DEGREES = (0.0, 30.0, 45.0, 60.0, 75.0, 80.0, 85.0, 88.0, 89.0, 89.9)


def energy_table(material: Material, degrees: Sequence[float] = TABLE_DEGREES) -> list[dict[str, float]]:
    """One row per wavelength and angle of incidence: the shares of the light that the material gives out.

    wavelength_um, degrees; diffuse, spike, lobe and their total, with strengths, Fresnel, masking and bound as the material has them;
    published: the total if the lobe were neither masked nor bounded, as CMU-RI-TR-91-16 prints it."""
    cosines = np.cos(np.radians(np.asarray(degrees, dtype=np.float64)))
    strengths = material.strengths()
    rows = []
    for w, wavelength in enumerate(material.wavelengths_um):
        k_lm, k_ss, k_sl, k_s = strengths[:, w]
        roughness, reach = two_numbers(material.sigma_um, material.correlation_um, wavelength)
        n, k = material.index_at(wavelength)
        metal = None if n is None else fresnel_table(n, k)
        spike = (k_ss + k_s) * np.exp(-4.0 * roughness * cosines**2) * _fresnel(cosines, n, k)
        lobe, published = np.zeros(len(cosines)), np.zeros(len(cosines))
        if k_sl + k_s > 0.0:
            masking = MASKINGS[material.masking]
            lobe = (k_sl + k_s) * lobe_albedo(cosines, roughness, reach, masking=masking, bounded=material.bounded, fresnel=metal)
            published = (k_sl + k_s) * lobe_albedo(cosines, roughness, reach, masking=UNMASKED, bounded=False, fresnel=metal)
        for j, angle in enumerate(degrees):
            parts = {"diffuse": float(k_lm), "spike": float(spike[j]), "lobe": float(lobe[j])}
            rows.append(
                {
                    "wavelength_um": float(wavelength),
                    "degrees": float(angle),
                    **parts,
                    "total": sum(parts.values()),
                    "published": float(k_lm + spike[j] + published[j]),
                }
            )
    return rows


def _fresnel(cosines: FloatArray, n: float | None, k: float | None) -> FloatArray:
    return np.ones(len(cosines)) if n is None else np.array([conductor_fresnel(c, n, k) for c in cosines])


def polar_components(material: Material, view_degrees: float, wavelength_um: float, steps: int = 721) -> dict[str, Any]:
    """Figure 3 as numbers: what a viewer at `view_degrees` sees of each component as the source goes round in the plane of view.

    degrees (steps,) of the source, -90..90, the mirror direction at +view_degrees; lobe and diffuse (steps,) in sr^-1 are BRDF times
    the source's cosine, the radiance per irradiance on a plane that faces the source; spike is the share of the radiance in the mirror
    direction. Raises ArrayError for a view outside 0..89.9 degrees."""
    if not 0.0 <= view_degrees <= 89.9:
        raise ArrayError(f"view_degrees is {view_degrees}; it must be 0 to 89.9 degrees from the normal", name="view_degrees")
    here = material.at((wavelength_um,))
    k_lm, k_ss, k_sl, k_s = here.strengths()[:, 0]
    degrees = np.linspace(-90.0, 90.0, steps)
    source = np.radians(np.abs(degrees))
    viewer = np.radians(view_degrees)
    n, k = here.index_at(wavelength_um)
    lobe = np.zeros(steps)
    if k_sl + k_s > 0.0:
        lobe = (k_sl + k_s) * lobe_brdf(
            source,
            viewer,
            np.where(degrees < 0, np.pi, 0.0),
            sigma_um=here.sigma_um,
            correlation_um=here.correlation_um,
            wavelength_um=wavelength_um,
            masking=here.masking,
            bounded=here.bounded,
        )
        lobe *= np.cos(source) * _fresnel(np.cos(0.5 * np.radians(degrees + view_degrees)), n, k)
    roughness, _ = two_numbers(here.sigma_um, here.correlation_um, wavelength_um)
    cosine = np.cos(viewer)
    spike = (k_ss + k_s) * np.exp(-4.0 * roughness * cosine**2) * _fresnel(np.array([cosine]), n, k)[0]
    return {
        "degrees": degrees,
        "diffuse": k_lm / np.pi * np.cos(source),
        "lobe": lobe,
        "spike": float(spike),
        "view_degrees": float(view_degrees),
        "wavelength_um": float(wavelength_um),
    }


def polar_chart(material: Material, view_degrees: Sequence[float] = (10.0, 45.0, 75.0), wavelength_um: float = 0.555) -> bytes:
    """Figure 3 for `material` as SVG: one half circle per viewing angle, each component against its own maximum, which the legend states.

    The same input gives the same bytes."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.hashsalt": "rangecheck", "font.family": "DejaVu Sans", "svg.fonttype": "path"}):
        figure = Figure(figsize=(4.2 * len(view_degrees), 3.6), layout="constrained")
        figure.suptitle(
            f"{material.name}: what a fixed viewer sees as the source goes round\n"
            f"σ {material.sigma_um:g} µm, T {material.correlation_um:g} µm, λ {wavelength_um:g} µm"
        )
        for column, angle in enumerate(view_degrees):
            parts = polar_components(material, angle, wavelength_um)
            axes = figure.add_subplot(1, len(view_degrees), column + 1, projection="polar")
            axes.set_theta_zero_location("N")  # type: ignore[attr-defined]
            axes.set_theta_direction(-1)  # type: ignore[attr-defined]
            axes.set_thetamin(-90)  # type: ignore[attr-defined]
            axes.set_thetamax(90)  # type: ignore[attr-defined]
            axes.set_ylim(0, 1.05)
            axes.set_yticks([0.25, 0.5, 0.75, 1.0], [])
            around = np.radians(parts["degrees"])
            for key, colour, words in (("diffuse", "#7f6a3c", "diffuse"), ("lobe", "#1f6fb4", "lobe")):
                most = float(parts[key].max())
                if most > 0.0:
                    axes.plot(around, parts[key] / most, color=colour, label=f"{words}, up to {most:.3g} sr⁻¹")
                    axes.fill(around, parts[key] / most, color=colour, alpha=0.12)
            if parts["spike"] > 1e-6:
                share = f"spike, {parts['spike']:.3g} of the mirrored radiance"
                axes.plot(np.radians([angle, angle]), [0, 1], color="#c0392b", linewidth=2.0, label=share)
            axes.plot(
                np.radians([-angle, -angle]), [0, 1.05], color="0.4", linewidth=1.0, linestyle=":", label=f"viewer, {angle:g}°"
            )
            axes.legend(loc="lower center", bbox_to_anchor=(0.5, -0.12), fontsize=8, frameon=False)
        with io.BytesIO() as stream:
            figure.savefig(stream, format="svg", metadata={"Date": None})
            return stream.getvalue()
