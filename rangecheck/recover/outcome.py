"""What a fit leaves behind: a material as every command takes it, with its uncertainties and what the pictures could not tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rangecheck.errors import SceneError
from rangecheck.recover.fit import TWO_SIDED_95, Estimate, Fitted
from rangecheck.recover.problem import Guess
from rangecheck.reflectance import Material


def material_of(fitted: Fitted, name: str = "fitted", metal: Material | None = None) -> tuple[Material, list[str]]:
    """The material that was found, at its wavelength, and what had to be assumed; spike and lobe share the strength that both have (K_s). `metal`: whose
    refractive index it was found with.

    A strength that the pictures do not determine, as of a highlight that is saturated, is at most what the surface does not send elsewhere; and strengths
    that add to more than 1 within their uncertainty add to 1. Raises SceneError where they add to more: then irradiance or exposure was not what it was
    taken to be."""
    guess, said = fitted.problem.material, []
    open_ones = {e.name for e in fitted.estimates if e.low is None}
    for mirrored in ("K_spike", "K_lobe"):
        most = max(0.0, 1.0 - guess.K_lm)
        if mirrored in open_ones and getattr(guess, mirrored) > most:
            guess = guess.but(**{mirrored: most})
            said.append(
                f"{mirrored} is taken to be {most:.4g}, the most that a surface can mirror beside K_lm; the pictures do not determine it"
            )
    both = min(guess.K_spike, guess.K_lobe)
    total = guess.K_lm + max(guess.K_spike, guess.K_lobe)
    if 1.0 < total <= 1.0 + TWO_SIDED_95 * max(_spread_of_total(fitted, guess), 1e-9):
        said.append(
            f"the strengths found add to {total:.4g}, within their uncertainty 1, the most that there is: they are made that"
        )
        guess = guess.but(**{name: getattr(guess, name) / total for name in ("K_lm", "K_spike", "K_lobe")})
        both, total = both / total, 1.0
    if total > 1.0:
        raise SceneError(
            f"the strengths found add to {total:.3g}, and no surface reflects more than it receives: only their product with the light's "
            f"irradiance is in the pictures; give an irradiance at least {total:.3g} times as large (sRGB pictures taken for linear seem too bright as well)",
            total=total,
        )
    material = Material(
        name, K_lm=guess.K_lm, K_ss=guess.K_spike - both, K_sl=guess.K_lobe - both, K_s=both, sigma_um=guess.sigma_um,
        correlation_um=guess.correlation_um, wavelengths_um=(guess.wavelength_um,), masking=guess.masking, **_index_of(metal),
    )  # fmt: skip
    return material, said


def as_far_as_known(fitted: Fitted) -> Fitted:
    """The same, without intervals where the fit did not settle: they would be of a place at which it would not have stayed."""
    if fitted.converged:
        return fitted
    estimates = [replace(e, low=None, high=None) for e in fitted.estimates]
    said = (
        "the fit did not settle, so that how well its numbers are known cannot be said; give better guesses, or more pictures",
    )
    return replace(fitted, estimates=estimates, determination=fitted.determination._replace(statements=said))


def with_what_is_taken(fitted: Fitted, material: Material, said: Sequence[str] = ()) -> Fitted:
    """The fit with what `material` holds instead of strengths that the pictures do not determine, and with more that is to be said of it."""
    spike, lobe, both = (float(np.asarray(k)) for k in (material.K_ss, material.K_sl, material.K_s))
    taken = {"K_lm": float(np.asarray(material.K_lm)), "K_spike": spike + both, "K_lobe": lobe + both}
    estimates = [replace(e, value=taken[e.name]) if e.low is None and e.name in taken else e for e in fitted.estimates]
    statements = (*said, *fitted.statements)
    return replace(fitted, estimates=estimates, determination=fitted.determination._replace(statements=statements))


def _spread_of_total(fitted: Fitted, guess: Guess) -> float:
    """Standard deviation of K_lm and the stronger of spike and lobe together, at `guess`."""
    names = ["K_lm", "K_spike" if guess.K_spike > guess.K_lobe else "K_lobe"]
    by = np.array([(p.name in names) * (guess.K_lobe if p.name == "K_lobe" else 1.0) for p in fitted.parameters])
    return float(np.sqrt(by @ fitted.determination.covariance @ by))


def _index_of(metal: Material | None) -> dict[str, Any]:
    return {} if metal is None else {"index_um": metal.index_um, "n": metal.n, "k": metal.k}


def material_toml(material: Material, fitted: Fitted, source: str) -> str:
    """The material as a file for `load_material`; table `uncertainty` holds 95 % intervals and what is not determined."""
    lines = [
        f"description = {_text('Recovered from photographs by rangecheck fit')}",
        f"source = {_text(source)}",
        # enough digits for strengths that add to 1 not to add to more
        *(f"{key} = {float(getattr(material, key)):.13g}" for key in ("K_lm", "K_ss", "K_sl", "K_s")),
        f"sigma_um = {material.sigma_um:.9g}",
        f"correlation_um = {material.correlation_um:.9g}",
        f"wavelengths_um = [{material.wavelengths_um[0]:.9g}]",
        f"masking = {_text(material.masking)}",
        "",
        *_index_table(material),
        "[uncertainty]",
        f"residual_in_noises = {fitted.scale:.4g}",
        f"not_determined = [{', '.join(_text(said) for said in fitted.statements)}]",
    ]
    for e in fitted.estimates:
        if not e.name.startswith(("light", "picture", "camera")):
            lines.append(f"{e.name} = {_interval(e)}")
    return "\n".join(lines) + "\n"


def _index_table(material: Material) -> list[str]:
    if not material.index_um:
        return []
    rows = {"wavelengths_um": material.index_um, "n": material.n, "k": material.k}
    return ["[index]", *(f"{key} = [{', '.join(f'{v:.9g}' for v in values)}]" for key, values in rows.items()), ""]


def _interval(e: Estimate) -> str:
    return "[]" if e.low is None or e.high is None else f"[{e.low:.6g}, {e.high:.6g}]"


def _text(value: str) -> str:
    escaped = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'
