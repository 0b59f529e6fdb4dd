"""Run an agent that `vusfa export` wrote, without torch: python run_onnx.py agent.onnx goal.jpg FOLDER

Needs numpy, pillow and onnxruntime. Prints one action per picture of the folder, in the order of names.
"""

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime
from PIL import Image

model, goal_file, folder = sys.argv[1:]
session = onnxruntime.InferenceSession(model)
meta = session.get_modelmeta().custom_metadata_map
actions, (height, width) = json.loads(meta["actions"]), json.loads(meta["size"])
resample, kinds = Image.Resampling[meta["interpolation"].upper()], {"tensor(bool)": bool}
if meta["crops"] != "whole":
    sys.exit("this example squashes pictures to the network's size; this agent's are cut")


def look(path, goal, room, memory):
    """The network's answers about a picture, by name."""
    picture = np.asarray(Image.open(path).convert("RGB").resize((width, height), resample))[None]
    answers = session.run(None, {"picture": picture, "goal": goal, "room": np.array([room]), **memory})
    return {one.name: answer for one, answer in zip(session.get_outputs(), answers, strict=True)}


given = [one for one in session.get_inputs() if one.name not in ("picture", "room")]
memory = {one.name: np.zeros((1, *one.shape[1:]), kinds.get(one.type, np.float32)) for one in given}
goal = look(goal_file, memory.pop("goal"), 0, memory)
if goal["rooms"].max() < float(meta["known"]):
    sys.exit(f"{goal_file} was not taken in {' or '.join(json.loads(meta['scenes']))}")
for path in sorted(Path(folder).iterdir()):
    found = look(path, goal["features"], int(goal["rooms"].argmax()), memory)
    memory = {name: found[f"next_{name}"] for name in memory}
    action, arrived = int(found["probabilities"].argmax()), found["similarity"][0] >= float(meta["arrived"])
    likely = found["probabilities"][0, action]
    print(f"{path.name}  {actions[action]}  {likely:.3f}{'  arrived' if arrived else ''}")
