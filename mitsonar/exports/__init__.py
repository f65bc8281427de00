"""Frames and data sets in the layouts of other tools: COCO, YOLO, WebDataset, Hugging Face, KITTI, neusis."""
