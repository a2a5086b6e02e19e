"""Guests of pcbench: adapters that each deliver a point cloud to be measured."""
