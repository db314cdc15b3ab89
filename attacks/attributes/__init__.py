"""What a private template tells of a person's gender, race and age: the paper's privacy experiment.

The paper's attacker takes the vote of the nearest neighbours; the stronger ones are trained on
faces that they lifted themselves.
"""
