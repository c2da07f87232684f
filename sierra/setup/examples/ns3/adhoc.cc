// Wi-Fi nodes at random places of a square, each of which sends to the next one over the same channel.
// Writes throughput.csv: the megabits of all nodes, one row for each simulated second.
// ns-3 itself reads the argument --RngRun, which chooses the random numbers.

#include <fstream>
#include <iostream>

#include "ns3/applications-module.h"
#include "ns3/core-module.h"
#include "ns3/internet-module.h"
#include "ns3/mobility-module.h"
#include "ns3/network-module.h"
#include "ns3/wifi-module.h"

using namespace ns3;

uint64_t sent = 0;      // bytes in the current second
uint64_t received = 0;

void Sent(Ptr<const Packet> packet) { sent += packet->GetSize(); }

void Received(Ptr<const Packet> packet, const Address&) { received += packet->GetSize(); }

void WriteRow(std::ofstream* file)
{
    *file << Simulator::Now().GetSeconds() << "," << sent * 8e-6 << "," << received * 8e-6 << "\n";
    sent = received = 0;
    Simulator::Schedule(Seconds(1), &WriteRow, file);
}

int main(int argc, char* argv[])
{
    uint32_t count = 10;
    double rate = 0.5;
    double size = 30.0;
    double end = 5.0;
    CommandLine line(__FILE__);
    line.AddValue("nodes", "Number of nodes, from 2 to 250", count);
    line.AddValue("rate", "Data that each node sends [Mbit/s]", rate);
    line.AddValue("size", "Side of the square [m]", size);
    line.AddValue("end", "Simulated time [s]", end);
    line.Parse(argc, argv);
    if (count < 2 || count > 250)
    {
        std::cerr << "--nodes must be from 2 to 250, not " << count << "\n";
        return 2;
    }

    NodeContainer nodes(count);
    MobilityHelper mobility;
    std::string range = "ns3::UniformRandomVariable[Min=0|Max=" + std::to_string(size) + "]";
    mobility.SetPositionAllocator("ns3::RandomRectanglePositionAllocator", "X", StringValue(range), "Y", StringValue(range));
    mobility.Install(nodes);

    YansWifiPhyHelper phy;
    phy.SetChannel(YansWifiChannelHelper::Default().Create());
    WifiMacHelper mac;
    mac.SetType("ns3::AdhocWifiMac");
    WifiHelper wifi;
    wifi.SetStandard(WIFI_STANDARD_80211a);
    wifi.SetRemoteStationManager("ns3::ConstantRateWifiManager", "DataMode", StringValue("OfdmRate6Mbps"));
    NetDeviceContainer devices = wifi.Install(phy, mac, nodes);
    InternetStackHelper().Install(nodes);
    Ipv4InterfaceContainer interfaces = Ipv4AddressHelper("10.0.0.0", "255.255.255.0").Assign(devices);

    const uint16_t port = 9;
    Ptr<UniformRandomVariable> start = CreateObject<UniformRandomVariable>();
    for (uint32_t from = 0; from < count; ++from)
    {
        InetSocketAddress to(interfaces.GetAddress((from + 1) % count), port);
        OnOffHelper source("ns3::UdpSocketFactory", to);
        source.SetConstantRate(DataRate(static_cast<uint64_t>(rate * 1e6)), 1000);
        source.Install(nodes.Get(from)).Start(Seconds(start->GetValue(0.0, 0.1)));
        nodes.Get(from)->GetApplication(0)->TraceConnectWithoutContext("Tx", MakeCallback(&Sent));
    }
    PacketSinkHelper sink("ns3::UdpSocketFactory", InetSocketAddress(Ipv4Address::GetAny(), port));
    ApplicationContainer sinks = sink.Install(nodes);
    for (uint32_t index = 0; index < count; ++index)
        sinks.Get(index)->TraceConnectWithoutContext("Rx", MakeCallback(&Received));

    std::ofstream file("throughput.csv");
    file << "time,sent,received\n";
    Simulator::Schedule(Seconds(1), &WriteRow, &file);
    Simulator::Stop(Seconds(end) + NanoSeconds(1));
    Simulator::Run();
    Simulator::Destroy();
    file.close();
    return file.fail();
}
