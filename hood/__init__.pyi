from hood.api import (
    Simulation as Simulation,
    differentiable as differentiable,
    dress as dress,
    export as export,
    load_model as load_model,
    rollout as rollout,
    simulate as simulate,
    train as train,
)
from hood.app.fit import fit as fit
from hood.app.output.view import view as view
from hood.assets.body.body import Body as Body
from hood.assets.body.load import load_body as load_body
from hood.assets.garment.garment import Garment as Garment, load_garment as load_garment
from hood.assets.files.library import names as names
from hood.assets.material import EdgeField as EdgeField, FaceField as FaceField, Material as Material
from hood.assets.motion.load import load_sequence as load_sequence
from hood.assets.motion.animated_mesh import BodyMesh as BodyMesh
from hood.assets.motion.sequence import PoseSequence as PoseSequence
from hood.rollouts.file.batches import RolloutBatches as RolloutBatches
from hood.rollouts.file.dataset import RolloutDataset as RolloutDataset
from hood.rollouts.gradients import step as step
from hood.rollouts.file.reader import RolloutData as RolloutData, read_rollout as read_rollout
from hood.steppers.published import load_reference_checkpoint as load_reference_checkpoint
from hood.energies.potential import Potential as Potential, default_potential as default_potential
from hood.scene.scene import Scene as Scene, build_scene as build_scene

__version__: str
__all__: list[str]
