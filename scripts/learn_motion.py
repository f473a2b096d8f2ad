"""Train a network on rollouts: ``hood dress`` makes them, ``hood.RolloutDataset`` reads them, torch does the rest.

It predicts how far vertices leave constant velocity, and tells its error on the last motion, which it has not seen.
"""

from __future__ import annotations

import sys

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

import hood
from hood.cli.main import main as command
from hood.mesh.geometry import vertex_normals
from hood.mesh.topology import unique_edges


def second(pos: Tensor) -> Tensor:
    """Second differences (B, V, 3) of three frames (B, 3, V, 3): how far the third is from constant velocity."""
    return pos[:, 2] - 2 * pos[:, 1] + pos[:, 0]


class Network(nn.Module):
    """Departures (B, V, 3) [m] from constant velocity: those of the body below, and a correction that begins at zero."""

    def __init__(self, faces: Tensor, width: int = 48) -> None:
        super().__init__()
        edges = torch.from_numpy(unique_edges(faces.numpy())).long()
        self.faces, (self.to, self.origin) = faces, torch.cat([edges, edges.flip(1)]).T
        self.begin = nn.Sequential(nn.Linear(15, width), nn.SiLU())
        self.passes = nn.ModuleList(nn.Sequential(nn.Linear(2 * width, width), nn.SiLU()) for _ in range(2))
        self.end = nn.Linear(width, 3)
        self.end.load_state_dict({key: torch.zeros_like(value) for key, value in self.end.state_dict().items()})

    def forward(self, cloth: Tensor, body: Tensor) -> Tensor:
        """From frames 0 to 2 of the cloth (B, 4, V, 3) and 0 to 3 of the body (B, 4, W, 3) [m]."""
        body = body[:, :, ::8]  # some of its vertices are near enough
        near = torch.cdist(cloth[:, 2], body[:, 2]).argmin(dim=-1)
        below = body.gather(2, near[:, None, :, None].expand(-1, 4, -1, 3))
        normal = torch.stack([vertex_normals(pos, self.faces) for pos in cloth[:, 2]])
        across = nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]).expand_as(normal), normal), dim=-1)
        frame = torch.stack([normal, torch.linalg.cross(normal, across), across], dim=-1)  # axes in columns
        slip = (cloth[:, 2] - cloth[:, 1]) - (below[:, 2] - below[:, 1])
        bends = [200 * second(pos) for pos in (cloth[:, :3], below[:, :3], below[:, 1:])]
        shown = torch.stack([*bends, 100 * slip, 10 * (cloth[:, 2] - below[:, 2])], dim=-1)
        nodes = self.begin((frame.transpose(-1, -2) @ shown).flatten(2))
        for one in self.passes:
            mean = torch.zeros_like(nodes).index_add(1, self.to, nodes[:, self.origin]) / 6
            nodes = nodes + one(torch.cat([nodes, mean], dim=-1))
        return second(below[:, 1:]) + 0.01 * (frame @ self.end(nodes)[..., None])[..., 0]


def main(motions: str = "plie,walk_steady,squats,twists,walk_proud", num_frames: str = "64", epochs: str = "8") -> None:
    words = [f"motions=[{motions}]", f"num_frames={num_frames}", "garments=[tank]", "stepper=newton", "formats=[cloth]"]
    if code := command(["dress", *words, "output=outputs/learn"]):
        raise SystemExit(code)
    unseen = motions.split(",")[-1]
    train = hood.RolloutDataset("outputs/learn", window=4, body="pos", where=lambda row: not row["row"].endswith(f"/{unseen}"))
    test = hood.RolloutDataset("outputs/learn", window=4, body="pos", rows=[f"*/{unseen}"])
    batches = hood.RolloutBatches(train, batch_size=4)
    torch.manual_seed(0)
    network = Network(train.mesh(0).faces)
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3)
    for epoch in range(int(epochs)):
        batches.set_epoch(epoch)
        for batch in DataLoader(train, batch_sampler=batches):
            guess, true = network(batch["cloth_pos"], batch["body_pos"]), second(batch["cloth_pos"][:, 1:])
            optimizer.zero_grad()
            (1000 * (guess - true)).norm(dim=-1).mean().backward()
            optimizer.step()
    with torch.no_grad():
        pairs = [(network(b["cloth_pos"], b["body_pos"]), second(b["cloth_pos"][:, 1:])) for b in DataLoader(test)]
    off, still = (1000 * torch.cat(found).norm(dim=-1).mean() for found in ([a - b for a, b in pairs], [b for _, b in pairs]))
    print(f"{unseen}, one step: network {off:.3f} mm, constant velocity {still:.3f} mm")


if __name__ == "__main__":
    main(**dict(word.split("=") for word in sys.argv[1:]))
