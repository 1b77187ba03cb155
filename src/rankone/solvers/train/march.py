"""Adaptive time slabs: march the sweeps over the horizon."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rankone.discretization import RadauCollocation
from rankone.solvers.reference import Reference
from rankone.solvers.train.groups import ParameterOperators, term_groups
from rankone.solvers.train.slab import SlabOperator
from rankone.solvers.train.sweep import Sweeper
from rankone.system import Array, System


@dataclass
class March:
    system: System
    reference: Reference
    scale: Array
    bases: list
    nodes: int
    tolerance: object
    log: list = field(default_factory=list)
    verbose: bool = False

    def initial(self):
        n, d = self.system.N_DIFFERENTIAL, len(self.bases)
        rows = [self.system.parameter_factors(j, b.nodes)*np.sqrt(b.weights) for j, b in enumerate(self.bases)]
        terms = self.system.INITIAL
        R = max(len(terms), 1)
        cores = [np.zeros((n, R))] + [np.zeros((R, b.size, R)) for b in self.bases]
        for k, (c, s, f) in enumerate(terms):
            cores[0][s, k] = c / self.scale[s]
            for j in range(d):
                cores[j+1][k, :, k] = rows[j][f[j]]
        if d: cores[-1] = cores[-1].sum(axis=2, keepdims=True)
        else: cores[0] = cores[0].sum(axis=1, keepdims=True)
        return right_orthonormal(cores)

    def run(self):
        sysm = self.system
        groups = term_groups(sysm)
        col = RadauCollocation.of(self.nodes)
        t, end = sysm.TIME
        source = self.initial()
        params = ParameterOperators(sysm, self.bases)
        h = (end - t)
        slabs = []
        centre = self.reference.points[0]
        pts = np.concatenate([[0.], col.nodes])
        while t < end*(1-1e-12):
            h = min(h, end - t)
            if end - t < 1.5*h and end-t>h: h = (end - t)/2
            eps = self.tolerance(t)
            # time resolution
            while True:
                vals = self.reference(t + h*pts)/self.scale[:sysm.N_DIFFERENTIAL, None, None]
                coef = vals @ col.to_modal.T
                tail = np.abs(coef[..., -2:]).max()
                if tail < 1*eps: break
                h *= max(0.5, min(.9,0.9*(eps/tail)**(1/self.nodes)))
            mean = sysm.lift(self.reference(t + h*col.nodes)[:, 0])
            A = sysm.lifted_jacobian(t + h*col.nodes, mean, centre)
            A = np.broadcast_to(A, (len(self.scale),)*2 + (self.nodes,))
            op = SlabOperator(sysm, col, t, h, self.scale, A)
            sw = Sweeper(op, groups, params, [op.initial(source[0]), *source[1:]], source)
            ok, its, res = False, 0, []
            d = len(self.bases)
            per = eps/np.sqrt(max(d,1))
            sw.settle(0.05, 10)
            prev=np.inf
            for its in range(1, 13):
                tol = per
                r2, tails = sw.iterate(tol); r1 = 0
                c = sw.settle(0.3*eps, 12)
                res.append((r1, r2, c))
                if not np.isfinite(r2) or (its >= 3 and r2 > .6*prev and r2 > 5*eps) or r2>1e3: break
                if r2 < 2*eps and max(tails, default=0) < eps: ok=True; break
                if its>=2 and max(tails, default=0) > eps:
                    new = [b if tl<eps else b.refined(40) for b, tl in zip(self.bases, tails)]
                    if self.verbose: print('   refine', [b.size for b in new])
                    tr = [a.transfer(b) for a, b in zip(self.bases, new)]
                    source = right_orthonormal([source[0]] + [np.einsum('ab,rbs->ras', T, c) for T, c in zip(tr, source[1:])])
                    cores = right_orthonormal([sw.cores[0].reshape(-1, sw.cores[0].shape[2])] + [np.einsum('ab,rbs->ras', T, c) for T, c in zip(tr, sw.cores[1:])])
                    cores[0] = cores[0].reshape(*op.shape, -1)
                    self.bases = new
                    params = ParameterOperators(sysm, new)
                    sw = Sweeper(op, groups, params, cores, source)
                    prev=np.inf
                    continue
                prev = r2
            if not ok:
                if self.verbose: print(f'reject t={t:.3g} h={h:.3g}', [f'{b:.1e}/{c:.1e}' for a,b,c in res], sw.ranks)
                h *= .6
                if h<1e-8: raise RuntimeError
                continue
            x0 = source[0] @ sw._source_right[1]
            if self.verbose: print(f't={t:.4g} h={h:.3g} its={its} eps={eps:.1e}', [f'{b:.1e}/{c:.1e}' for a,b,c in res], sw.ranks, [b.size for b in self.bases])
            slabs.append((t, h, x0, sw.cores, list(self.bases)))
            source = [sw.cores[0][:sysm.N_DIFFERENTIAL, -1]*np.sqrt(col.count), *sw.cores[1:]]
            t += h
            if its <= 3: h *= 1.4
            elif its>=6: h*=.75
        return slabs

def right_orthonormal(cores):
    cores = list(cores)
    for j in range(len(cores)-1, 0, -1):
        r, n, s = cores[j].shape
        q, R = np.linalg.qr(cores[j].reshape(r, n*s).T)
        cores[j] = q.T.reshape(-1, n, s)
        cores[j-1] = cores[j-1] @ R.T
    return cores
