"""The methods that RPM-Net is compared with: ICP, SAC-IA, FGR, DCP, PointNetLK, PCRNet."""
