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
actions, size, before = json.loads(meta["actions"]), int(meta["size"]), int(meta["history"]) - 1
resample = Image.Resampling[meta["interpolation"].upper()]
if meta["crops"] != "whole":
    sys.exit("this example squashes pictures to the network's square; this agent's are cut")


def look(path, goal, room, history):
    """Features, probabilities of the actions, similarity with the goal, similarity with each room."""
    picture = np.asarray(Image.open(path).convert("RGB").resize((size, size), resample))[None]
    given = {"picture": picture, "goal": goal, "room": np.array([room])}
    return session.run(None, {**given, "history": np.stack(history, 1)} if before else given)


nothing = np.zeros((1, session.get_outputs()[0].shape[1]), np.float32)
goal, _, _, rooms = look(goal_file, nothing, 0, [nothing] * before)
room, history = int(rooms.argmax()), []
if rooms.max() < float(meta["known"]):
    sys.exit(f"{goal_file} was not taken in {' or '.join(json.loads(meta['scenes']))}")
for path in sorted(Path(folder).iterdir()):
    history = history or [look(path, goal, room, [nothing] * before)[0]] * before
    features, probabilities, similarity, _ = look(path, goal, room, history)
    history = [*history, features][1:]
    action, arrived = int(probabilities.argmax()), similarity[0] >= float(meta["arrived"])
    print(f"{path.name}  {actions[action]}  {probabilities[0, action]:.3f}{'  arrived' if arrived else ''}")
