"""Best subsets of candidate laws by one linear regression at a mode, without a refit.

Sparse identification of dynamics (Brunton, Proctor and Kutz, PNAS 113, 2016) by best subsets
(Bertsimas and Gurnee, Nonlinear Dynamics 111, 2023), with the simulator's derivatives as the
library: nothing is differentiated from data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pbrl_ppl.criticism.score import (
    Library,
    Linearisation,
    ScoreTest,
    Signature,
    null_sides,
    same_physics,
)
from pbrl_ppl.effects import Attached
from pbrl_ppl.state import Floats, Ints
from pbrl_ppl.system.threads import Say, in_parallel, silent


@dataclass(frozen=True, eq=False)
class Subset:
    """Laws that explain a residual together, to first order.

    Parameters
    ----------
    sizes : dict of Attached to ndarray
        Parameters of each law by the joint regression, shape (q,) each.
    nats : float
        Log-evidence less its price.
    share : float
        Share of the squared whitened residual that they take away.
    phi : ndarray
        The mode's other parameters by the joint regression, shape (p,).
    """

    sizes: Mapping[Attached, Floats]
    nats: float
    share: float
    phi: Floats

    @property
    def laws(self) -> tuple[Attached, ...]:
        """The laws, in the order of the catalogue."""
        return tuple(self.sizes)

    def begin(self, labels: Sequence[str]) -> dict[str, float]:
        """Return where a refit begins, by the labels of parameters; ``labels`` are those of phi."""
        return dict(zip(labels, self.phi.tolist(), strict=True)) | by_label(self.sizes)


def by_label(sizes: Mapping[Attached, Floats]) -> dict[str, float]:
    """Return the parameters of laws by their labels."""
    return {
        label: float(size)
        for law, each in sizes.items()
        for label, size in zip(law.labels, each, strict=True)
    }


def worth(share: float, columns: int, n: float) -> float:
    """Return the log-evidence (nats) of columns that take a share of n squared residuals away."""
    left = max(1.0 - share, 1e-15)  # of exact data nothing is left
    return -0.5 * n * float(np.log(left)) - 0.5 * columns * float(np.log(n))


@dataclass(frozen=True, eq=False)
class Regression:
    """Subsets of a model's candidates, best first.

    Parameters
    ----------
    subsets : tuple of Subset
        Every subset that was tried.
    same : dict of Attached to tuple of Attached
        Candidates that are the same physics here, by the one that is tried for them.
    signatures : tuple of Signature
        Score tests of all candidates, best first.
    """

    subsets: tuple[Subset, ...]
    same: Mapping[Attached, tuple[Attached, ...]]
    signatures: tuple[Signature, ...]


@dataclass(frozen=True, eq=False)
class Term:
    """A law linearised at one point, its columns in the regression, and its price (nats).

    That is the logarithm of the number of candidates and grid points that it is chosen from, less
    the logarithm of its prior odds.
    """

    law: Attached
    linear: Linearisation
    columns: Ints
    price: float

    def sizes(self, coordinates: Floats, most: float, *, least: float = 0.5) -> Floats | None:
        """Return the law's parameters; None where one breaks a sign, or a whole change its size.

        ``most``: prior scales from the linearisation at which sizes are clipped.
        ``least``: smallest size of a whole change, as by an obstacle, which is of size 1.
        """
        change = self.linear.back @ coordinates
        free = list(self.linear.columns)
        if not free and not least < change[0] < 1.0 / least:
            return None
        if len(free) == 1 and null_sides(self.law)[free[0]] * change[0] < 0:
            return None
        effect, sizes = self.law.effect, self.linear.sizes(coordinates)
        reach = most * np.array([parameter.prior.scale for parameter in effect.parameters])
        near = np.clip(sizes, self.linear.values - reach, self.linear.values + reach)
        return np.where(np.isin(np.arange(len(sizes)), free), near, sizes)


def best_subsets(
    library: Library,
    candidates: Sequence[Attached],
    without: tuple[Attached, ...] = (),
    *,
    largest: int = 3,
    say: Say = silent,
) -> Regression:
    """Search the subsets of a few laws that explain the residual of a mode.

    A subset S of laws with q columns is worth ``-n/2 log(1 - |P_S r|^2 / |r|^2) - q/2 log n`` less
    its price, with the whitened residual r, the projection P_S on the laws' signatures, both
    without what parameters and initial states absorb, and n degrees of freedom. Subsets whose
    least-squares sizes break a sign that a prior sets are left out.

    Parameters
    ----------
    library : Library
        Of a model that lacks the candidates.
    candidates : sequence of Attached
        Effects to choose from.
    without : tuple of Attached
        Laws of the model that are left out, to first order.
    largest : int
        Laws in a subset, at most.
    say : callable
        Called with how many candidates are linearised.
    """
    problem, residual, count = library.mode.problem, library.test(without).residual, len(candidates)
    told = f"linearising {count} laws on pieces of {problem.data.horizon} rows", say
    signatures = in_parallel(lambda one: library.scored(one, count, without), candidates, *told)
    signatures.sort(key=lambda one: round(one.log_p, 3))
    total = float(residual @ residual)
    n = max(float(problem.likelihood.counts(problem.observations).sum()), 2.0)
    distinct, same = _distinct(signatures, candidates)
    if not distinct or total <= 0.0:
        return Regression((), same, tuple(signatures))
    terms: list[Term] = []
    width = 0
    for signature in _leading(distinct, residual):
        law = signature.attached
        price = np.log(len(distinct) * signature.candidate.n_grid_points) - law.effect.log_odds
        for linear in signature.linear[:3]:  # grid points of a scan
            columns = np.arange(width, width + linear.basis.shape[1])
            terms.append(Term(law, linear, columns, float(price)))
            width += len(columns)
    order = {law: place for place, law in enumerate(candidates)}
    equations = _NormalEquations(terms, library.test(without), n)
    tried = equations.search([order[term.law] for term in terms], largest)
    tried.sort(key=lambda subset: -subset.nats)
    return Regression(tuple(tried), same, tuple(signatures))


class _NormalEquations:
    """Normal equations of the regression of a residual on the columns of terms.

    Parameters
    ----------
    terms : sequence of Term
        Laws at one point each, the columns of which are in their order.
    test : ScoreTest
        The residual, and the mode's parameters without the columns.
    n : float
        Measurements over their autocorrelation times.
    """

    def __init__(self, terms: Sequence[Term], test: ScoreTest, n: float) -> None:
        self.terms, self.test, self.n = terms, test, n
        basis, residual = np.hstack([term.linear.basis for term in terms]), test.residual
        self.gram, self.towards = basis.T @ basis, basis.T @ residual
        self.absorbed = np.hstack([term.linear.absorbed for term in terms])
        self.total = float(residual @ residual)

    def solved(self, chosen: Sequence[int], *, independent: float = 1e-5) -> Subset | None:
        """Return the subset of some terms; None if they are collinear, or a size is impossible.

        ``independent``: least ratio of the eigenvalues of a subset's equations.
        """
        terms = [self.terms[i] for i in chosen]
        columns = np.concatenate([term.columns for term in terms])
        values, vectors = np.linalg.eigh(self.gram[np.ix_(columns, columns)])
        if values[0] < independent * values[-1]:
            return None
        coordinates = vectors @ ((vectors.T @ self.towards[columns]) / values)
        ends, sizes = np.cumsum([len(term.columns) for term in terms]), dict[Attached, Floats]()
        for term, part in zip(terms, np.split(coordinates, ends[:-1]), strict=True):
            size = term.sizes(part, self.test.criteria.far_out)
            if size is None:
                return None
            sizes[term.law] = size
        share = min(float(coordinates @ self.towards[columns]) / self.total, 1.0 - 1e-12)
        nats = worth(share, len(columns), self.n) - sum(term.price for term in terms)
        phi = self.test.phi - self.absorbed[:, columns] @ coordinates
        return Subset(sizes, nats, share, phi)

    def search(self, order: Sequence[int], largest: int, *, beam: int = 12) -> list[Subset]:
        """Return the subsets tried: all of one or two laws, then the best with one more law.

        ``order`` is the place of each term's law in the catalogue, ``beam`` the number of subsets
        of each size that are enlarged.
        """
        level: dict[tuple[int, ...], Subset] = {
            (i,): one for i in range(len(self.terms)) if (one := self.solved((i,))) is not None
        }
        tried = dict(level)
        for _ in range(largest - 1):
            grown: dict[tuple[int, ...], Subset] = {}
            best = sorted(level, key=lambda chosen: -level[chosen].nats)
            for chosen in best if len(next(iter(level), ())) == 1 else best[:beam]:
                laws = {self.terms[i].law for i in chosen}
                for i in (i for i, term in enumerate(self.terms) if term.law not in laws):
                    more = tuple(sorted((*chosen, i), key=lambda i: (order[i], i)))
                    if more not in tried and (one := self.solved(more)) is not None:
                        grown[more] = tried[more] = one
            level = grown
        return list(tried.values())


def _distinct(
    signatures: Sequence[Signature], candidates: Sequence[Attached]
) -> tuple[list[Signature], dict[Attached, tuple[Attached, ...]]]:
    """Return the visible candidates, one of each physics, and those that it stands for.

    The most common one with the fewest parameters stands for the others, then the first.
    """
    order = {law: place for place, law in enumerate(candidates)}

    def simple(signature: Signature) -> tuple[float, int]:
        law = signature.attached
        return 2 * len(law.labels) - law.effect.log_odds, order[law]

    distinct: list[Signature] = []
    same: dict[Attached, tuple[Attached, ...]] = {}
    for signature in sorted(signatures, key=simple):
        if not signature.linear or not signature.basis.shape[1]:
            continue
        first = next((one for one in distinct if same_physics(one, signature)), None)
        if first is not None:
            same[first.attached] = (*same[first.attached], signature.attached)
        elif signature.candidate.statistic > 0:
            distinct.append(signature)
            same[signature.attached] = ()
    return distinct, same


def _leading(distinct: Sequence[Signature], residual: Floats) -> list[Signature]:
    """Return the 14 candidates that take most away alone, and 8 beside the first of them."""

    def taken(signature: Signature) -> float:
        return float(((signature.basis.T @ residual) ** 2).sum())

    leading = sorted(distinct, key=taken, reverse=True)[:14]
    first = leading[0].basis
    left = residual - first @ (first.T @ residual)

    def taken_beside(signature: Signature) -> float:
        rest = signature.basis - first @ (first.T @ signature.basis)
        q, r = np.linalg.qr(rest)
        return float(((q[:, np.abs(np.diag(r)) > 1e-3].T @ left) ** 2).sum())

    second = sorted(distinct, key=taken_beside, reverse=True)[:8]
    return list(dict.fromkeys([*leading, *second]))
